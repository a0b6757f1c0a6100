"""The report: a run folder, a screen, a page, TensorBoard, and where it all came from."""
