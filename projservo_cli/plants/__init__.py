"""What is being controlled: simulated robots and rigs that know the truth."""
