"""The process that a task runs in: threads, compiled kernels, interrupts."""
