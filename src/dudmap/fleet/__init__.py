"""Maps of many runs: registration of pairs, poses of all, fusion by ranges of space, tiles; all in worker processes."""
