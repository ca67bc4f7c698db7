"""The host's side of a run: flags, folder, loop, progress, tables, pictures."""
