"""Plants: whatever carries a plan out. `sumo` is the real one, `macroscopic` the model; both have one method, `run`."""
