"""A page that shows stylised runs: `sparsestyle gallery`."""
