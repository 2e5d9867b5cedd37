"""What watches a vehicle that drives: faults of its motion and obstacles laid in its way."""
