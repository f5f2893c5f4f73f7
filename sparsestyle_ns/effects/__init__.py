"""Which parts of the simulation a scene needs: each is measured, and decided once, with the reason.

To add an effect: write a file here with a function that measures a scene and the `Effect` (`base.py`), list it in
`registry.EFFECTS`, and give it a field in `base.EffectSettings`. The table, the record and the viewer follow. Whoever
simulates it asks `decisions.on(name)`, or calls a function of the effect's own file that builds what is needed.
"""
