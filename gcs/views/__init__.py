"""What people look at: live table, Rerun recording, pictures, pages. `report` turns results into words."""
