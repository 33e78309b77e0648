"""The commands, by what they are about: looking around, data, one cell, a grid."""
