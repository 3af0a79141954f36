"""Instruments: rigid parts as triangulated surfaces, and where they are for a pose and a closure."""
