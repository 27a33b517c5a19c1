"""The run of a law: the robot that it drives, the loop it is driven in, and its record."""
