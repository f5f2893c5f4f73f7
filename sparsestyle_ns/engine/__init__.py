"""Training: the trainer, one step, one checkpoint writer, restyling, previews, and what to type next."""
