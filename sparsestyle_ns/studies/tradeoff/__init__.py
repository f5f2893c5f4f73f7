"""How long to wait for how good a result: error against time, measured on a scene and a machine.

`command` runs it, and `study` holds what is measured. `stage1`, `stage2`, `quadrature`, `rendering` and `precision`
measure axes; `words`, `plots` and `report` say and show what was found. `pareto` and `budget` are plain arithmetic.
"""
