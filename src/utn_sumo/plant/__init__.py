"""Plants: whatever carries a plan out and is measured. `sumo` is the real one; all share one method, `run`."""
