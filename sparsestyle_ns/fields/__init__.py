"""The coarse and the residual radiance field."""
