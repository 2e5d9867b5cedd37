"""Image files: pairs, headers, calibration boards, and the stages that read them."""
