"""The dense cloud: fused from point maps in bounded memory."""
