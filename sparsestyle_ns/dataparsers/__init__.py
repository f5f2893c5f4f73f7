"""Readers of scene folders, as nerfstudio dataparsers."""
