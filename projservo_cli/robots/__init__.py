"""What is driven: true robots and rigs, simulated ones, and those of users."""
