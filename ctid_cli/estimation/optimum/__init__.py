"""Global minimum of the output error over a bounded set of models."""
