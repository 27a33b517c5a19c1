"""The closed loop: compiled for the built-in laws, in Python for any law or plant."""
