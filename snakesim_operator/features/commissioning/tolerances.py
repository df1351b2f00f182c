"""What a joint check tolerates. Imports nothing: the command line reads it before it knows what will run."""

# Between the fraction of the motion that the links made and the expected one.
MAX_RATIO_ERROR = 0.12
# 0.6 degrees; an intact gear and the noise of its gyros show half of it.
ALLOWED_BACKLASH_RAD = 0.01
