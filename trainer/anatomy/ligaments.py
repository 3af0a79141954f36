"""stub"""
from __future__ import annotations
from typing import Any
from trainer.anatomy.label_volume import LabelVolume
def swept_cruciates(volume: LabelVolume, side: str) -> tuple[LabelVolume, dict[str, Any], dict[str, str]]:
    return volume, {}, {}
