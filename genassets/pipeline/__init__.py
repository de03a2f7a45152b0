"""The machine: fingerprints, store, plan and executor. It knows stages by name and contract only."""
