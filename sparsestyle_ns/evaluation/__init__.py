"""Measures of reconstruction and stylisation."""
