"""From rays to pixels: pure functions of tensors."""
