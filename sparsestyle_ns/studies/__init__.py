"""What is found out with many runs: `compare` and `ablate` for the paper's tables, `tradeoff` for time and accuracy.

`study` says what all runs of a study share, and `page` shows what was found. `runs` trains whole runs, each in a
process of its own, and `run_figures` measures them; `tradeoff` trains within this process and a time budget.
"""
