"""Tasks: rewards, samplers, the curriculum and the banks of training tasks."""
