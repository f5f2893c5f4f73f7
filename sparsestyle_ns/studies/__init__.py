"""What is found out with many runs: `compare` and `ablate` for the paper's tables, `tradeoff` for time and accuracy."""
