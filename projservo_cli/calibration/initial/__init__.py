"""Start of the adjustment: geometry of the views, places of markers, then screws and cameras."""
