"""BOP datasets as webdataset shards, with the card of the Hugging Face hub."""
