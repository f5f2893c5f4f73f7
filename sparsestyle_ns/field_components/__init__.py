"""Encodings that fields are built from, as nerfstudio field components."""
