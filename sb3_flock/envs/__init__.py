"""The faces of the task that others' tools expect: PettingZoo's parallel env and SB3's vector env."""
