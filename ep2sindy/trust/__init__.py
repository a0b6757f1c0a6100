"""Guards against files, configs and folders of strangers, and against what ends a run early."""
