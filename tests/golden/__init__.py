"""Every number of shipped configurations, third-party data and small sweeps, to hold a change against."""
