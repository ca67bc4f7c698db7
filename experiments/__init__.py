"""The commands as modules; what the paper's figures are made of is in ``experiments.paper``."""
