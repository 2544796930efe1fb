"""The method: functions of one particle or one node with their adjoints, shared by every scheme."""
