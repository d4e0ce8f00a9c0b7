"""The map: state, store, pose graph, georeferencing, fusion."""
