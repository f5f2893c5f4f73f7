"""From a folder of photos to a scene that a dataparser reads."""
