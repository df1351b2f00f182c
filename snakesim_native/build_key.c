// The key of a build: a hash of its sources and of what else decides the result. `load.py` compares it with the
// sources that it finds, so that a library of other sources is never used.

const char* snakesim_build_key(void);

const char* snakesim_build_key(void) { return SNAKESIM_BUILD_KEY; }
