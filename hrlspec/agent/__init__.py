"""The agent: networks, distributions, and the pure functions that act with them."""
