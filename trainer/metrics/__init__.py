"""Scores of a session, as pure functions over its record and its task."""

from trainer.metrics import anastomosis, arthroscopy, handling, motion, piercing
from trainer.metrics.registry import REGISTRY, Definition, available, check_targets, definition_of, score

#: The modules whose import fills the registry, and the headings under which reports show them.
FAMILIES = {piercing: "Needle", anastomosis: "Stitch", arthroscopy: "Tissue", motion: "Motion", handling: "Handling"}

__all__ = ["FAMILIES", "REGISTRY", "Definition", "available", "check_targets", "definition_of", "score"]
