"""The effects that everybody has, by what they act on; `registry` reads each file's list."""
