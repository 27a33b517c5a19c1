"""Objects that goals are taught on: found again, and tracked while they move."""
