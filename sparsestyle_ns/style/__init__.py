"""What is known of the style: its image, its colours, its features."""
