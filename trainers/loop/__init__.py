"""The training loop: context, setup, callbacks, metrics, checkpoints."""
