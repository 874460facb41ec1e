"""What people look at: the live table, the recording and the viewer."""
