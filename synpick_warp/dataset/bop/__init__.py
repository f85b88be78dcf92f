"""BOP folders as anybody writes them: listings that stay inside, layout, scenes."""
