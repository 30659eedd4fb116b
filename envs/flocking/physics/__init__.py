"""Quadcopter physics in torch and in PyBullet behind one interface."""
