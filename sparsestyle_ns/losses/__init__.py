"""The style and content losses, one a file."""
