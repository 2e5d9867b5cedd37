"""From elevations to a risk map, for one vehicle."""
