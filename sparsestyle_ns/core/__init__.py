"""Pure functions: rays, samples, weights, spaces and schedules. No configs, no nerfstudio models."""
