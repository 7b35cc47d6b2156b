"""Where releases lie: local folders, object stores, the Hugging Face Hub."""
