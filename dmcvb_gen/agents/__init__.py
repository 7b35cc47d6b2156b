"""The paper's agents: representation learning, policies, decoders, their data and one trainer (PyTorch)."""
