"""Report of a run: figures, claims, the page, the 3D view and the animation."""
