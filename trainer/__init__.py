"""Training and assessment of surgical skill; see README.md."""

__version__ = "0.1.0"
