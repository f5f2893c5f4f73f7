"""Lets every test say `from reference import ...`, wherever in the tree it lies."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
