"""How fast, and in how little memory, measured beside peers in the same run.

    make bench                              # all of them, then the table
    python -m benchmarks.hash_grid --help   # one of them

Each writes benchmarks/results/NAME.json; benchmarks.summary makes summary.json and summary.md of them.
"""
