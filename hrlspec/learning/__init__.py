"""Learning: collection, relabelling, targets, losses, and one training iteration."""
