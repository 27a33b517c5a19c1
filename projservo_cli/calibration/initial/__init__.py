"""Where the adjustment begins: geometry of the views, places of markers, then screws and cameras."""
