"""Walk: the world."""
