"""Everything that people look at: live table, Rerun recording, pictures, pages. `report` puts results into words."""
