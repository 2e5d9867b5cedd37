"""Facts of the stages: what their results state beside arrays, by the room that states it."""
