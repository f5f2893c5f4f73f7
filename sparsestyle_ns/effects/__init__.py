"""Which effects a scene calls for: measured in one place, decided once, with the reason.

Adding one: a class in a file here that says what it measures and what it builds (`base.Effect`), and its line in
`registry.EFFECTS`. Setting, table and record follow from it; the place that needs what it builds asks
`Decisions.build`, which gives None where it is off.
"""
