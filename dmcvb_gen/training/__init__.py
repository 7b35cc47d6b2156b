"""Train behaviour policies into run folders of checkpoints, and select policy files from them."""
