"""What people look at: tables, pages, pictures of poses, the 3D view."""
