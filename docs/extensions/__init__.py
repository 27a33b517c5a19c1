"""How pages are made from the code: extensions of Sphinx."""
