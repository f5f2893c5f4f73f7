"""Photos and their cameras: nerfstudio dataparsers, the choice of views, and points that photos share."""
