"""Which parts of the simulation a scene needs: each is measured, and decided once, with the reason."""
