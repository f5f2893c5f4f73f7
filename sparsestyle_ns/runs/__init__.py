"""Runs on disk: finding, reading and matching them."""
