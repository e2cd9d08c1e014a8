"""The environments of the paper."""
