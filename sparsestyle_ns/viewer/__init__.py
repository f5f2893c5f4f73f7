"""The "Style" panel of nerfstudio's viewer, and what it does."""
