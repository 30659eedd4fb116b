"""Imitation loss and learner, shared by behaviour cloning and DAgger."""
