"""What a joint check tolerates. Imports nothing: the command line reads it before it knows what will run."""

# 0.6 degrees; an intact gear and the noise of its gyros show half of it.
ALLOWED_BACKLASH_RAD = 0.01
