"""Drawing, films, series of frames and the viewer."""
