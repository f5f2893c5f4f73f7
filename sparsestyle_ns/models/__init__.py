"""The two methods as nerfstudio models."""
