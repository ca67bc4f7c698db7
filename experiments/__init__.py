"""The command lines and what they share: run folders, signals, errors."""
