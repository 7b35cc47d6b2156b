"""Storage of releases: folders, object stores, web servers and the Hugging Face Hub.

Begin with `store.open_store`; `interface.Store` says what every store does.
"""
