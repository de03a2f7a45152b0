"""Changed logs: actors swapped, turned, removed and inserted, in images, sweeps and labels alike."""
