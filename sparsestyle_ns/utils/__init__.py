"""What every layer may use: errors, progress, files, names, processes."""
