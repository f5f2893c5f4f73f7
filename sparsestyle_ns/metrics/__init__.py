"""Measures of pictures, one a file."""
