"""How long a test waits for what another process or thread does."""

#: A machine that is busy has taken a minute for what takes a second. No limit of the product is stretched by it.
PATIENCE_S = 120.0
