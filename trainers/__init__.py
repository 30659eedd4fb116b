"""Trainers: behaviour cloning, DAgger and MAPPO, and the pieces they are made of."""
