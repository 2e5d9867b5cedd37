"""Images as the matcher reads them, window by window, and its parameters."""
