"""How long to wait for how good a result: error against time, measured on a scene and a machine.

`measuring` runs it on a `workbench`, within a `time_budget`. The modules `measure_…` measure the `curves`; `advice` and
`tradeoff_report` say and show what was found. `pareto` is plain arithmetic.
"""
