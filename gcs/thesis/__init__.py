"""`gcs thesis`: the source's figures and numbers, published and computed."""
