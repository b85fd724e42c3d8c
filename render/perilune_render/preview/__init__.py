"""Pictures of a configuration: a contact sheet of frames, and a map of the site."""
