"""Networks of both levels, as flax modules written for one unbatched item."""
