"""Letter: the world and its contested layouts."""
