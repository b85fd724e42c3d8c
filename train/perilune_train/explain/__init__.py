"""Evidence on what the attention gates of trained networks do: tables, pictures and claims."""
