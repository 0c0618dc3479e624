"""From a real arm and its cameras to a calibration file: link files, RealSense cameras, boards, hand-eye calibration."""
