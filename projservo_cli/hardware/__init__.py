"""Hardware that people own: cameras, servos, printed tags, and checks before they are used."""
