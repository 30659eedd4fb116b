"""Trainers: behaviour cloning and DAgger, and the pieces they are made of."""
