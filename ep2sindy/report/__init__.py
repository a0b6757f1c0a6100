"""The report: run folder, terminal, HTML page, TensorBoard, and the provenance of a run."""
