"""Pictures and films of states and recordings: ``softmpm.show`` and ``softmpm.to_video``."""
