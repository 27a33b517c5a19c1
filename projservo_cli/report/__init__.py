"""What a run says: figures, claims, the page, the 3D view and the animation."""
