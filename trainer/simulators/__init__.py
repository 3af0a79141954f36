"""Devices played by the program, byte for byte, on pseudo-terminals: as unkind as the real ones."""
