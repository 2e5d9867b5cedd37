"""What is computed: pure functions on arrays. This package imports nothing on its own."""
