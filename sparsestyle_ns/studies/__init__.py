"""Studies of many runs or settings: `compare`, `ablate` and `tradeoff`."""
