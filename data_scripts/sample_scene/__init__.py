"""A small ray tracer for a sample scene: noise and textures -> shapes -> scene -> tracer -> files.

World coordinates are right-handed with z up. A camera looks along its own -z, with x to the right and y up; a
camera-to-world matrix maps its coordinates to the world's. The centre of the pixel in row i and column j is at
(j + 0.5, i + 0.5), the principal point at (width / 2, height / 2). Points, directions and colours are float32 arrays
with the component first, (3, N). Surfaces are matt unless the scene's `shine` is above 0, so a point has the same
colour in every picture that shows it, unless the pictures are exposed differently.
"""
