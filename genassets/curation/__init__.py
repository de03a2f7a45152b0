"""From masks to a clean object benchmark: the object table, occlusion, acceptance rules, crops."""
