"""Pictures of labelled volumes on the processor: section, surface, volume (Gibson et al. 1998, section 4.2.4)."""
