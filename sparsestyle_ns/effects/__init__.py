"""Which parts of the simulation a scene needs: each is measured, and decided once, with the reason.

To add an effect: write a function here that measures a scene, list it in `registry.EFFECTS`, and give it a field in
`base.EffectSettings`. The table, the record and the viewer follow. Whoever simulates it asks `decisions.on(name)`, or
calls a function beside the measuring one that builds what is needed.
"""
